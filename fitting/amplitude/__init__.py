"""Strain sweeps: moduli that change with the amplitude of an oscillation, and the law behind them."""
