"""Pages that quote numbers of the scripts: the front page, the guides, those of this folder, from their JSON."""
