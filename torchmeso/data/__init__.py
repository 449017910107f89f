"""Containers, each with its files."""
