"""The feedback rules, and the commands that steer the vehicles."""
