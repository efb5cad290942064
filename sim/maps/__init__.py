"""Conversion of a Gaussian map to collision geometry: the table, objects on it, and ellipsoids for the rest."""
