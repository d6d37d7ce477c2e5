"""Long runs, sweeps, designs of experiments and their files."""
