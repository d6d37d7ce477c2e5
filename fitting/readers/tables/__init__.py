"""Tables in files: lines, headings, cells, and the moduli of a sweep from whatever columns there are."""
