"""GIOROM: simulate a sparse sample of the particles, then recover every point.

The public names follow the order in which data flow through the method
(arXiv:2407.03925): state, sampling, graph, features, time-stepper, integration, field.
"""

__version__ = "0.1.0"
