"""Which positions to take: their information, the best schemes with proof, the next position.

Open `information` first.
"""
