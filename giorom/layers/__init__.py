"""Building blocks of the time-steppers, in the order the data meet them."""
