"""Dressed meshes to pictures."""
