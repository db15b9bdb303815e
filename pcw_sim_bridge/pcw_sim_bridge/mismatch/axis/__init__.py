"""A bench axis as the analyser sees it: its channel, and its forward simulation."""
