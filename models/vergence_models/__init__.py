"""The science: network, data, training, evaluation, export."""
