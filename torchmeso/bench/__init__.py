"""Run time against error, one suite per stage."""
