"""Building blocks of the time-stepper, in the order the data meet them."""
