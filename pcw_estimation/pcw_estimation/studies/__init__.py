"""Studies that measure the estimators: drawn robots and drives, and the figures of the documentation."""
