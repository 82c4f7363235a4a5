"""What is seen of a recording: entities, layout, colours, charts, and the words of its log."""
