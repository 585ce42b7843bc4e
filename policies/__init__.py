"""Networks, training, evaluation and (later) deployment of walking policies."""
