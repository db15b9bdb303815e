"""`mismatch`: compares recordings with a description and says what the model leaves out."""
