"""What drivers make of readings and commands: stamps, glitches, counts, and torques that say nothing."""
