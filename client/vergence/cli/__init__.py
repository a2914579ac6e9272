"""The ``vergence`` command. Needs the extra ``vergence[cli]``; the rest of the client does not."""
