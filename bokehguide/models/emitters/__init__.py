"""Emitters with an exact density on the lens: parallelograms, and bright peaks of an environment map."""
