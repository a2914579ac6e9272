"""The results of jobs: their files on a server, and the layouts in which people read them.

Read ``records`` (what is known of each frame), ``frame_file`` (one frame as a server keeps and
sends it) and ``manifest`` first, then ``folders``: servers make archives of them, clients folders.
"""
