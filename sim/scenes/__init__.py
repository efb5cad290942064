"""The scenes that splatbot ships (YAML)."""
