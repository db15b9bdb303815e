"""The mismatch analyser: what a recording shows that the description of the robot or axis does not hold."""
