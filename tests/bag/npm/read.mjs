// Reads MCAP files with the npm readers that Foxglove uses; prints every message, one JSON a line.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { decompress } from "fzstd";

const plain = (value) => {
  if (typeof value === "bigint") return Number(value);
  if (typeof value === "number") return Number.isFinite(value) ? value : String(value);
  if (value instanceof Uint8Array) return Buffer.from(value).toString("base64");
  if (ArrayBuffer.isView(value)) return Array.from(value, plain);
  if (Array.isArray(value)) return value.map(plain);
  if (value !== null && typeof value === "object") {
    // This reader names the members of a time sec and nsec.
    const isTime = "nsec" in value && Object.keys(value).length === 2;
    return Object.fromEntries(
      Object.entries(value).map(([key, inner]) => [
        isTime && key === "nsec" ? "nanosec" : key,
        plain(inner),
      ]),
    );
  }
  return value;
};

for (const path of process.argv.slice(2)) {
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      await file.read(buffer, 0, Number(length), Number(offset));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({
    readable,
    decompressHandlers: { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) },
  });
  const readers = new Map();
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    const schema = reader.schemasById.get(channel.schemaId);
    if (!readers.has(channel.id)) {
      const text = new TextDecoder().decode(schema.data);
      readers.set(channel.id, new MessageReader(parse(text, { ros2: true })));
    }
    const decoded = readers.get(channel.id).readMessage(message.data);
    console.log(
      JSON.stringify({
        topic: channel.topic,
        type: schema.name,
        encoding: [channel.messageEncoding, schema.encoding],
        hash: channel.metadata.get("topic_type_hash"),
        log: String(message.logTime),
        publish: String(message.publishTime),
        value: plain(decoded),
      }),
    );
  }
  await file.close();
}
