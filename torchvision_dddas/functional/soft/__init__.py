"""Soft stand-ins for the hard steps of a pipeline, so that gradients pass: each tends to its step as softness vanishes.

Softness is a Python number, as in `ops.threshold`: at 0.0 the hard step itself.
"""
