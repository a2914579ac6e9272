"""Who calls: principals, their tokens and certificates. Read ``principals``, then ``tokens``."""
