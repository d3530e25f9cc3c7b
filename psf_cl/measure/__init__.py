"""Comparing images with references."""
