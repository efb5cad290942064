"""From a Gaussian map to physics: the table, objects on it, and ellipsoids for the rest."""
