"""A vehicle's line to a server: the newest map, and ballots that are never lost."""

from mapvote.client.connection import Refused as Refused
from mapvote.client.connection import Unreachable as Unreachable
from mapvote.client.map_client import Manifest as Manifest
from mapvote.client.map_client import MapClient as MapClient
from mapvote.client.map_client import Plane as Plane
from mapvote.client.map_client import Region as Region
