"""Whether something touches, and whether it changed."""
