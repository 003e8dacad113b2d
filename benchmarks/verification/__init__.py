"""Physical benchmarks of the simulator: a figure and a row of numbers per quantity.

``python -m benchmarks.verification --out docs/verification`` runs them at full size and
writes the figures, ``results.json`` and the tables of ``README.md``. The tests in
``tests/verification`` run the same functions at a size that a test can afford.
"""
