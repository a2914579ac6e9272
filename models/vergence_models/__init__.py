"""The research part: networks, synthetic data, training, evaluation, export and studies."""
