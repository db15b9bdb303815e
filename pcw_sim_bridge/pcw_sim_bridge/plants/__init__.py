"""Simulated robots behind one interface (`plant`)."""
