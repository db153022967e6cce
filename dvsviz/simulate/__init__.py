"""Motions, scenes and sensors that make recordings with known truth."""
