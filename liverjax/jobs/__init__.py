"""Long runs, sweeps, designs of experiments, and the files of their results."""
