"""Other people's logs, one module per layout, each turned into the rows of a recording.

`recognise` finds the layout by content, never by the file's name. An importer returns a
`log.Log`: rows, header entries and sentences on what the log does not say. Nothing is
assumed of the robot: no pose, no quantisation, no bus.
"""
