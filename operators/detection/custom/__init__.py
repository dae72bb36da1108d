"""A grid detector for a robot's own objects: data, network, loss, decoding, training and score."""
