// The source of the splats: an address, or chunks of base64 in the document that together are one
// gzip of a .ply.
function bytesOf(base64) {
    const text = atob(base64);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return bytes;
}

async function fetched(address) {
    const onDisk = location.protocol === "file:";
    const again = onDisk
        ? "a browser reads no other files from disk: put the folder on a web server, or use `splat view`."
        : "Load the page again; where `splat view` has ended, start it again.";
    const answer = await fetch(address).catch((error) => {
        throw new Error(`the download failed (${error.message}). ${again}`);
    });
    if (!answer.ok) throw new Error(`the download failed (${answer.status}). ${again}`);
    return answer;
}

// () => a response with the whole .ply, each time.
async function sourceOf(scene) {
    if (scene.content) return () => fetched(scene.content);
    const parts = [];
    for (const element of document.querySelectorAll("script.splats")) {
        parts.push(bytesOf(element.textContent));
        element.remove(); // so that the text and the bytes need not both stay in memory
    }
    const plain = new Blob(parts).stream().pipeThrough(new DecompressionStream("gzip"));
    const whole = await new Response(plain).blob().catch(() => {
        throw new Error("the file is damaged. Get it again.");
    });
    return () => new Response(whole, { headers: { "content-length": String(whole.size) } });
}

// The rows of a .ply of 32-bit floats that begin with x, y and z, without those that `holds` refuses.
function filtered(bytes, holds) {
    const head = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 16));
    const start = head.indexOf("end_header\n") + "end_header\n".length;
    const stride = 4 * head.slice(0, start).match(/^property float /gm).length;
    const view = new DataView(bytes.buffer);
    const kept = [];
    for (let at = start; at + stride <= bytes.length; at += stride) {
        const [x, y, z] = [0, 4, 8].map((offset) => view.getFloat32(at + offset, true));
        if (holds(x, y, z)) kept.push(bytes.subarray(at, at + stride));
    }
    const counted = head.slice(0, start).replace(/^element vertex \d+$/m, `element vertex ${kept.length}`);
    return new Blob([Uint8Array.from(counted, (letter) => letter.charCodeAt(0)), ...kept]);
}
