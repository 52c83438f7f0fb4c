"""The front door: ``trotd …``."""
