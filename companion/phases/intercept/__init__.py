"""Phase `intercept`: wait, see a ball in flight, and take the net to it.

`ball` follows the single markers of motion capture and predicts the one that falls, `meeting` chooses where and when to meet it within
every limit, and `phase` waits, flies there, stops and comes back.
"""
