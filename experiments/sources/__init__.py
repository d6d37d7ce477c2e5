"""Scripts that made the files of data/ and tests/."""
