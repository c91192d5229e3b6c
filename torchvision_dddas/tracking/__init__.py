"""Targets over time: detections to identities."""
