"""Folders that tests read from."""

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
ASSETS = REPOSITORY.parent / "shared" / "assets"
"""Real models and HDR maps, where a checkout has them beside it; a test that needs one is skipped elsewhere."""
