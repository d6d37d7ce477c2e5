"""A run of a scene: one step, the whole run, its derivatives, batches."""
