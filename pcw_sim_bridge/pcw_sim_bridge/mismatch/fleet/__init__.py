"""Many recordings of many robots, and what became of each."""
