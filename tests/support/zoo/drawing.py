"""A module that seeds and draws while it is loaded, as some do."""

import random

import numpy as np

random.seed(0)
np.random.seed(0)
random.random(), np.random.random()
