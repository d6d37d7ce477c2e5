"""The physics of a scene, mostly one file each: elasticity, viscosity, porosity, contact, supports, loads, motions."""
