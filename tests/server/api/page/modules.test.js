// Facts of the page's modules that need no browser. Run by test_page_modules.py.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { beforeEach, test } from "node:test";

globalThis.location = { origin: "http://localhost", pathname: "/", hash: "" };
globalThis.history = { replaceState: (_, __, hash) => (location.hash = hash) };
globalThis.matchMedia = () => ({ matches: true, addEventListener() {} });

const api = await import("../viewer/api.js");
const { address, number, when } = await import("../viewer/page.js");
const { distance, inside, levelAt, pointAt } = await import("../viewer/stage.js");
const { Orbit } = await import("../viewer/orbit.js");
const { groundOf } = await import("../viewer/cloud.js");
const { Stream, SPACING, unpack } = await import("../viewer/stream.js");

const bytesOf = (name) => {
  const data = readFileSync(new URL(`./${name}`, import.meta.url));
  return data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
};
const close = (a, b, by = 1e-6) => assert.ok(Math.abs(a - b) <= by, `${a} is not ${b}`);

beforeEach(() => void (location.hash = ""));

test("the address holds what is set in a fixed order and drops what is null", () => {
  address.write({ eye: "1,2,3", from: 4 });
  address.write({ change: "built.v2.3.4 &", from: null });
  address.flush();
  assert.equal(location.hash, "#change=built.v2.3.4%20%26&eye=1,2,3");
  assert.deepEqual(address.read(), { change: "built.v2.3.4 &", eye: "1,2,3" });
});

test("what nobody knows in an address is left out", () => {
  location.hash = "#colour=age&alert(1)=2";
  assert.deepEqual(address.read(), { colour: "age" });
});

test("numbers and times are told as a reader reads them", () => {
  assert.deepEqual([number(3), number(2.5)], ["3", "2.5"]);
  assert.deepEqual([when("2026-11-20T08:15:00Z"), when(null)], ["2026-11-20 08:15 UTC", "unknown"]);
});

test("a refusal has the server's words", async () => {
  const asked = [];
  globalThis.fetch = async (url, more) => (asked.push([url, more]), new Response(JSON.stringify({ detail: "ask the operator" }), { status: 403 }));
  await assert.rejects(api.changes(1, 2), { message: "ask the operator", status: 403 });
  assert.deepEqual(asked, [["http://localhost/v1/changes?from=1&to=2", {}]]);
});

test("a server that does not answer is told from one that refuses", async () => {
  globalThis.fetch = async () => { throw new TypeError("failed"); };
  await assert.rejects(api.manifest(), { status: 0 });
});

test("events come whole however the line cuts them, and comments and rubbish are none", async () => {
  const sent = ': listening\n\nid: 7\ndata: {"seq":7,"kind":"publish"}\n\ndata: {rubbish\n\nid: 8\ndata: {"seq":8}\n\nid: 9\ndata: {"se';
  const pieces = [...sent].map((c) => new TextEncoder().encode(c));
  globalThis.fetch = async () => new Response(new ReadableStream({ start(c) { pieces.forEach((p) => c.enqueue(p)); c.close(); } }));
  const found = [];
  for await (const event of api.events()) found.push(event);
  assert.deepEqual(found, [null, { seq: 7, kind: "publish" }, { seq: 8 }]);
});

test("a place is inside a polygon, not in its hole and not beside it", () => {
  const square = (x, y, side) => [[x, y], [x + side, y], [x + side, y + side], [x, y + side], [x, y]];
  const change = { polygons: [[square(0, 0, 10), square(4, 4, 2)], [square(20, 0, 1)]] };
  assert.deepEqual([[1, 1], [5, 5], [11, 1], [20.5, 0.5]].map((at) => inside(change, at)), [true, false, false, true]);
});

// A camera that looks straight down from 50 m upon (x, y) = (10, 10).
const above = (parts, slice = [-1e4, 1e4]) => ({
  ray: ([px, py]) => ({ from: [10 + px, 10 + py, 50], way: [0, 0, -1] }),
  shared: { pixels: { value: 1000 }, ratio: { value: 1 }, slice: { value: { toArray: () => slice } } },
  parts,
});
const part = (points, visible = true) => ({
  points: { visible }, corner: [0, 0], z0: 0, zStep: 0.01,
  packed: Uint16Array.from(points.flatMap(([x, y, z]) => [Math.round((x * 65535) / 76.8), Math.round((y * 65535) / 76.8), Math.round(z * 100), Math.round((z + 10) * 100)])),
});

test("a click meets the nearest visible point within eight pixels", () => {
  const low = part([[10, 10, 1], [12, 10, 9]]), high = part([[10, 10, 5]]), hidden = part([[10, 10, 20]], false);
  close(pointAt(above([low, high, hidden]), [0, 0])[2], 5, 0.01);
  close(pointAt(above([low, high], [-1e4, 3]), [0, 0])[2], 1, 0.01);
  assert.equal(pointAt(above([low]), [5, 0]), null);
});

test("a click that meets no point meets the level of the target, if it looks down upon it", () => {
  assert.deepEqual(levelAt(above([]), [1, 2], 4), [11, 12, 4]);
  assert.equal(levelAt(above([]), [0, 0], 60), null);
  close(distance([0, 3, 0], [4, 0, 12]), 13);
});

test("the eye stays at its distance from what it looks at, and a state comes back as it was set", () => {
  const orbit = new Orbit({ clientWidth: 800, clientHeight: 600, addEventListener() {} }, () => {}, () => {});
  orbit.state = [5, 6, 7, 40, 0.3, 0.5];
  close(distance(orbit.eye, [5, 6, 7]), 40);
  orbit.turn(100, 1e6);
  assert.ok(orbit.state[5] < Math.PI / 2, "never over the top");
  orbit.flyTo([0, 0, 20, 10], 2, { margin: 1 });
  assert.deepEqual(orbit.target, [10, 5, 2]);
});

test("a cloud of the server is read as it was written", () => {
  const cloud = unpack(bytesOf("level.bin")), told = JSON.parse(readFileSync(new URL("./level.json", import.meta.url)));
  assert.equal(cloud.packed.length, 4 * told.points.length);
  told.points.forEach(([x, y, z], i) => {
    close((cloud.packed[4 * i] * 76.8) / 65535, x, 0.001);
    close((cloud.packed[4 * i + 1] * 76.8) / 65535, y, 0.001);
    close(cloud.z0 + cloud.packed[4 * i + 2] * cloud.zStep, z, 0.002);
  });
  close(groundOf(cloud), told.ground, 0.02);
  assert.throws(() => unpack(new ArrayBuffer(16)), /no cloud/);
});

// A cloud that notes what it is given, and is never drawn.
const canvasless = () => {
  const held = new Set(), value = (v) => ({ value: v });
  const add = (told) => {
    const made = { ...told, count: told.packed.length / 4, points: { geometry: { setDrawRange() {} }, material: { uniforms: { spacing: value(0), evidence: value(null) } } } };
    held.add(made);
    return made;
  };
  return { held, add, remove: (gone) => held.delete(gone), draw() {}, origin: [0, 0, 0], sides: "new", shared: { pixels: value(500), ratio: value(1), coarse: value(1) },
    camera: { position: { x: 38, y: 38, z: 30 } }, frustum: () => ({ intersectsBox: () => true }) };
};

test("what came and went is marked on its tile, on both sides or each on its own", () => {
  const cloud = canvasless(), stream = new Stream(cloud, {});
  stream.fetch = () => {};
  stream.changes(bytesOf("changed.bin"), { x0: 100, y0: 200 }, false);
  assert.deepEqual([...cloud.held].map((m) => [m.x, m.y, m.count, m.side]), [[100, 200, 3, "both"]]);
  stream.changes(bytesOf("changed.bin"), { x0: 0, y0: 0 }, true);
  assert.deepEqual([...cloud.held].map((m) => m.side), ["old"], "the marks before are gone");
});

test("of two states of a map the tiles that are equal are loaded once", () => {
  const stream = new Stream(canvasless(), {}), hashes = (points) => ({ points, ground: "g" });
  stream.setTiles({ x0: 0, y0: 0 }, { "0,0": hashes("a"), "0,1": hashes("b") }, { "0,0": hashes("a"), "0,1": hashes("c"), "1,0": hashes("d") });
  assert.deepEqual(stream.tiles.map((t) => [t.name, t.hashes.points, t.side]), [["0,0", "a", "both"], ["0,1", "b", "new"], ["0,1", "c", "old"], ["1,0", "d", "old"]]);
});

test("a plan draws no more points than its budget, the coarse ones first", () => {
  const cloud = canvasless(), stream = new Stream(cloud, {});
  stream.marked = true;
  stream.fetch = () => {};
  stream.setTiles({ x0: 0, y0: 0 }, { "0,0": { points: "a", ground: "g" } }, null);
  for (const level of [0, 1, 2]) stream.take(stream.tiles[0], level, { z0: 0, zStep: 1, packed: new Uint16Array(400) }, level + 1, SPACING[level]);
  cloud.camera.position = { x: 0, y: 0, z: 0 };
  stream.plan(150);
  assert.deepEqual(stream.tiles[0].levels.map((p) => p.share), [100, 50, 0]);
});

test("votes are asked for of the tiles in view, a few at a time, and once for each choice", async () => {
  const asked = [], cloud = { ...canvasless(), texture: () => ({ dispose() {} }) };
  let open = 0, most = 0;
  const evidence = async (name, vehicle) => {
    asked.push(`${name} ${vehicle ?? "all"}`);
    most = Math.max(most, ++open);
    await new Promise((done) => setTimeout(done, 1));
    open--;
    return new ArrayBuffer(4);
  };
  const stream = new Stream(cloud, { evidence });
  const all = Array.from({ length: 3000 }, (_, i) => [`0,${i}`, { points: `p${i}`, ground: "g" }]);
  stream.fetch = () => {};
  stream.setTiles({ x0: 0, y0: 0 }, Object.fromEntries(all), null);
  const look = (from, to) => {
    cloud.frustum = () => ({ intersectsBox: (box) => box.min.x >= 76.8 * from - 1e-3 && box.min.x < 76.8 * to - 1e-3 });
    stream.plan();
  };
  look(10, 30);
  await stream.evidence(true, undefined);
  assert.deepEqual([asked.length, most], [20, 6]);
  look(20, 40);
  await stream.tell();
  assert.equal(asked.length, 30, "those that came into view");
  look(0, 3000);
  await stream.tell();
  assert.ok(asked.length <= 30 + 256, `${asked.length} asked with the whole city in view`);
  look(10, 30);
  const before = asked.length;
  await stream.evidence(true, "a");
  assert.deepEqual(asked.slice(before).sort()[0], "0,10 a");
  assert.equal(asked.length, before + 20, "of one vehicle");
  await stream.evidence(false);
  assert.ok(stream.tiles.every((tile) => !tile.evidence));
});
