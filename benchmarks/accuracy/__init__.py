"""The honest score of every pretrained model, and the report of them.

``python -m benchmarks.accuracy`` scores all models on scenes made afresh, measures how long their
rollouts last, what other discretisations cost and how far the solver itself is from repeating its
own motion, writes ``metrics.json`` beside each model and ``docs/results/accuracy.md`` from these
files. What is required stands in ``requirements.py`` and is judged from the numbers alone.
"""
