"""The evidence: one script a question, its results, and the pages that quote them."""
