"""Jobs: what a configuration asks for, stage after stage."""
