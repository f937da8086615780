"""The commands of ``multipos``, one module each with ``run(arguments)``; options in a table.

Open `fit` first, a whole command; `answers` delivers what every command gives.
"""
