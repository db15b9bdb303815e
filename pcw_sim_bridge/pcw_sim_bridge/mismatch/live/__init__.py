"""The channels of a running robot, judged while it drives."""
