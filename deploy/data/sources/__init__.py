"""Readers, one per file format: each returns tables (`source_table`) with the names of `quantity_names`."""
