"""A scene: what it is made of, read from a file, checked."""
