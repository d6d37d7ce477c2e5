"""Tables in files: lines, headings, cells, and the moduli of a sweep from the columns that a file has."""
