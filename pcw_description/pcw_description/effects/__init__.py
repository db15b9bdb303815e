"""Physical effects beyond the nominal model: one file each, read by simulators, analyser and report alike."""
