"""The configuration files that splatbot ships (YAML)."""
