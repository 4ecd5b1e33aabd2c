"""Formats of measured images: each becomes a dataset."""
