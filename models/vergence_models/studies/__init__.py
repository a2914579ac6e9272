"""The studies of Stereo Matching in Time (WACV 2024), run on our networks and our data.

``python -m vergence_models.studies --json FILE`` writes tables, Markdown and plots; see __main__.
"""
