"""Emitters with exact densities on the lens: parallelograms, and peaks of an environment map."""
