"""How the files of data/ and tests/ were made."""
