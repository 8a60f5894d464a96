"""Trained policies that come with the program, as safetensors."""
