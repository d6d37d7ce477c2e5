"""One file a physics: viscosity, porosity, averaged volumes, supports, loads and prescribed motion."""
