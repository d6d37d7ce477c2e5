"""The physics, one file each: viscosity, porosity, averaged volumes, supports, loads and prescribed motion."""
