"""What can be analysed, a bench axis or a robot, behind one interface."""
