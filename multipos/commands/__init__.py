"""The commands of ``multipos``, a module each with ``run(arguments)``; options in ``options.csv``.

Open `fit` first, a whole command; `answers` delivers what every command gives.
"""
