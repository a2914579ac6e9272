"""Jobs: whole sequences that a server steps, from a notebook or a program.

Read ``client`` first: ``requests`` makes lost connections harmless, ``packing`` makes the upload,
``frames`` is what comes back, ``saving`` writes it, and ``blocking`` is the same without asyncio.
"""
