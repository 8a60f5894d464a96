"""Descriptions of robots (`NAME.toml`) and of what is learned with them (`NAME.task.toml`), as files."""
