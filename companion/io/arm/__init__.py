"""The arm's bus thread, which every arm has, and the driver of an arm that a plug-in provides."""
