"""Force and stiffness of elements: MJED, its references, stiffness without negative eigenvalues."""
