"""Recordings on disk: one file a format, recognised by content."""
