"""The command line `skin`. Heavy imports stay inside the commands, so that `skin press` starts in a blink."""
