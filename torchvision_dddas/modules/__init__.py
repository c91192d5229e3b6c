"""What can be learned: knobs as parameters, and the hard steps of the pipeline as soft modules of the same `ops`."""
