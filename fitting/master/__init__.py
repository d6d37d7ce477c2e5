"""Master curves: sweeps at several temperatures are shifted to one reference temperature."""
