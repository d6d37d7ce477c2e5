"""Force and stiffness of elements: MJED, reference methods, and a stiffness without negative eigenvalues."""
