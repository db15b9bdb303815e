"""What is said of a search: effects with numbers, doubts, look-alikes and places."""
