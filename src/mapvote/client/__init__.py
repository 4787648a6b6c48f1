"""A vehicle's line to a server: the newest map, and ballots that are never lost."""

from mapvote.client.connection import Refused as Refused
from mapvote.client.connection import Unreachable as Unreachable
from mapvote.client.map_client import MapClient as MapClient
from mapvote.client.map_client import Region as Region
from mapvote.codec.manifest import Manifest as Manifest
from mapvote.codec.manifest import TileHashes as TileHashes
