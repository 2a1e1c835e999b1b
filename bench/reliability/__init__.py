"""The parts of `skin bench faults` and `skin bench drift`: scenes, a skin in simulated time, the scores."""
