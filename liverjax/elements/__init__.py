"""Force and stiffness of elements: MJED, references for it, and a stiffness without negative eigenvalues."""
