"""A mesostructure in, tables out."""
