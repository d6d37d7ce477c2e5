"""Pages that quote numbers of the scripts: README.md and those of this folder, written from their JSON."""
