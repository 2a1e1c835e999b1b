"""The board without hardware: a program behind a serial device, and the skin that it measures."""
