"""What `skin bench faults` and `skin bench drift` are made of: scenes, a skin in simulated time, what is counted."""
