"""Networks and SGBM stepped over footage, and the figures that compare them."""
