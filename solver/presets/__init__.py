"""Preset tracks and vehicles as TOML files; every number stands in one of them once."""
