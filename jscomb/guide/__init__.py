"""Pages: how to choose a method, files, large frames, recipes for research.

.. include:: choosing.md

.. include:: files.md

.. include:: large_frames.md

.. include:: recipes.md
"""

__all__: list[str] = []
