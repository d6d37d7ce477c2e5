"""Read tables from files: lines, headings and cells, and the moduli of a frequency sweep from its columns."""
