"""Materials and light transport, shared by baking and truth."""
