"""Pages with numbers from the scripts' JSON files: the front page, the guides, and the pages of this folder."""
