"""Directions, frames, cameras, lights, meshes and rays."""
