"""Commands that talk to a service, with the arguments they need."""

PRESS_AND_WATCH = (
    ("press", "--x", 0, "--y", 0, "--force", 1),
    ("release",),
    ("scene", "slide"),
    ("fault", "hang"),
    ("tare",),
    ("top", "--once", "--seconds", 0.1),
    ("echo", "contact", "--timeout", 0.1),
    ("compare", "--seconds", 0.1),
)
TALKERS = (*PRESS_AND_WATCH, ("record", "file.mcap", "--seconds", 0.1), ("doctor",), ("calibrate", "force"))
