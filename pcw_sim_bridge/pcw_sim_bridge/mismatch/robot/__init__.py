"""A robot on powered casters as the analyser sees it: its channels, what a healthy one may differ in, and every candidate."""
