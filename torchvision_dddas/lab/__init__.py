"""The laboratory: what simulates, proves, tunes and exports the system. Only `cli` imports it."""
