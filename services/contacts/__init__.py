"""From an image to contacts: where each is, which one it is, how hard it presses."""
