"""Synthesis: a small exemplar in, maps that cover any surface out."""
