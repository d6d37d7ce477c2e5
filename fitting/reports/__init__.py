"""Tables, pictures and files of fits."""
