"""The commands of ``multipos``, one module each: ``add_options(parser)`` and ``run(arguments)``.

Open `fit` first, a whole command; `answers` delivers what every command gives.
"""
