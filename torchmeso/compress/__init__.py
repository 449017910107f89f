"""fit(...) -> a run-time container."""
