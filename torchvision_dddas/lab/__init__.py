"""The laboratory: simulation, evaluation, tuning and export of the system. Only `cli` imports it."""
