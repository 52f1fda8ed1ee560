"""TOML scene files."""
