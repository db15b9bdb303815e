"""Studies that measure the estimators, and write what they find into the documentation."""
