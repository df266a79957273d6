"""YAML presets and the list of all settings; found through importlib.resources."""
