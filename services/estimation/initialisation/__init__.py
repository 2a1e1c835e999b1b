"""The first baseline of a skin: whether its scans agree, and whether nothing touches while they do."""
